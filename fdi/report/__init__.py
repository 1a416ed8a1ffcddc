"""What a command answers: one report value, written as terminal text, HTML or JSON; figures and number formatting."""

from lazy_loader import attach_stub

__getattr__, __dir__, _ = attach_stub(__name__, __file__)
