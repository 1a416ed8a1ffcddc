"""Model against measurement: how large the error is, where, when, and in which block of the actuator."""
