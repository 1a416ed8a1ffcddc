"""Words that the settings of a run may have. The module imports nothing, because help must be quick."""
PACES = ("lockstep", "realtime")
PLANTS = ("auto", "builtin", "external")
CONTROLLERS = ("builtin", "c", "external")
