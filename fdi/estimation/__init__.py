"""Parameters from measurements: replay, noise, likelihood, fit, covariance, tolerances, unidentifiable directions."""

from lazy_loader import attach_stub

__getattr__, __dir__, _ = attach_stub(__name__, __file__)
