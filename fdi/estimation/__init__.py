"""Parameters from measurements: replay, noise, likelihood, fit, covariance, tolerances, unidentifiable directions."""
