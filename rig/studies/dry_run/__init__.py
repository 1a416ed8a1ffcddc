"""A dry run: what a sequence asks for, held against the limits of the actuator, before anything moves."""
