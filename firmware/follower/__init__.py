"""The follower: pings and answers in, packets out."""
