"""A matrix of cases, simulated and judged on all cores or on a cluster, and the statistics of what came out."""
