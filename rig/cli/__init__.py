"""The `rig` command: one file per subcommand, its options and the terminal."""
