"""Modem dialects on pseudo-terminals, over one simulated water."""
