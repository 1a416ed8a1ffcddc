"""Reading and writing recordings: one type, `Trace`, for logs of the bench, CSV files and foreign formats."""

from lazy_loader import attach_stub

__getattr__, __dir__, _ = attach_stub(__name__, __file__)
