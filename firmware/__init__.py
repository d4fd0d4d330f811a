"""What runs on a vehicle: sub-maps, compression, the follower and the leader."""
