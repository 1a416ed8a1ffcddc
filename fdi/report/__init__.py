"""What a command answers: one report value, written as terminal text, HTML or JSON; figures and number formatting."""
