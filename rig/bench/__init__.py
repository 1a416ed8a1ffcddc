"""Speed of the bench and of the analyses, beside C and the tools of the system, measured in one run."""
