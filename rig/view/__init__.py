"""The rerun viewer on traces, and the screens that show a run while it runs."""
