"""Batches of independent jobs that survive an interruption: the runner below the blind trial and the campaign."""
