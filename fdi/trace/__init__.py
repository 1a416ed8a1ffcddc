"""Reading and writing recordings: one type, `Trace`, for logs of the bench, CSV files and foreign formats."""
