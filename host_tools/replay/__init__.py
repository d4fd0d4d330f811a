"""Readers of real multibeam logs."""
