"""The nominal model of a user's actuator: its parameters from measured runs, with what these runs cannot tell."""
