"""The leader: pings and packets in; trajectories, map and answers out."""
