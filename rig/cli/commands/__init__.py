"""One module per subcommand: add_arguments(parser) and run_command(args) -> exit status, which holds heavy imports."""
