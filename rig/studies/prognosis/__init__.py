"""How good remaining lives are, scored on simulated units."""
