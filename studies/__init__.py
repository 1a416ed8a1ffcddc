"""Studies: the evidence for what this software claims, made with its public names; not installed."""
