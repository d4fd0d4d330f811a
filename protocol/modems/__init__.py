"""Modem drivers behind one interface, chosen by URL."""
