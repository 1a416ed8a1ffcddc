"""What is done offline on a captured trace: no CAN, no viewer."""
from fdi.trace.trace import Trace

__all__ = ["Trace"]
