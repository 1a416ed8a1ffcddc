"""Where the project is, and where the shared material is when it lies beside the checkout."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
SHARED = ROOT.parent / "shared"
SUPPORT = Path(__file__).parent
