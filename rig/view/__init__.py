"""The rerun viewer on a trace."""
