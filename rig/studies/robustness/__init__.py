"""Robustness, counted: invented frames, killed and stopped processes, full disks, long work."""
