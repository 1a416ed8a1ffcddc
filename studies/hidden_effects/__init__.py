"""The blind trial: cases whose truth another solver makes, and how often the explanation finds it."""
