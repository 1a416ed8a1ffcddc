"""Requirements with what verifies them, and sealed packages of runs."""
