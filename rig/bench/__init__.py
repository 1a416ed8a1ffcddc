"""Speed beside C and other libraries, measured in one run."""
