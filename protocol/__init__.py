"""What crosses the water: packets, codec, reassembly, the medium and the modems."""
