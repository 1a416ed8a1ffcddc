"""One module per subcommand, which does its work: `run_command(args)` returns the exit status."""
