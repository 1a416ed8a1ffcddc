"""A run while it runs: rows in shared memory, and a process of its own that reads and shows them."""
