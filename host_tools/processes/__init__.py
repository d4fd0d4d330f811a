"""Vehicles as processes of their own: the clock and the water between them, and what they write."""
