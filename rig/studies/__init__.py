"""Studies over many runs: blind trial, campaign, prognosis scores and benchmarks."""
