"""What runs on a desk: simulator, missions, evaluation, report and the command line."""
