"""How fault sizes grow from trace to trace, and when they will reach MidBand and MaxBand."""
