"""Which physics is missing: replay, noise, fits, search, verdict."""
