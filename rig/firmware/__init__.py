"""Reference firmware in C99: sources, the generator of their object table, and how `rig` builds them."""
