"""Squeezes the soundings of one sub-map into the payload of a few frames."""
