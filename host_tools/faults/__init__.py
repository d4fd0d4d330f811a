"""Fault simulation: production code of two vehicles while water, modem, clock and disk fail."""
