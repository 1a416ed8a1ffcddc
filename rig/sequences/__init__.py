"""The test sequences that come with the rig: TOML files, found by name."""
