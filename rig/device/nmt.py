"""NMT slave (CiA 301, 7.3.2): the state machine and the error behaviour object 0x1029."""

from collections.abc import Callable

from rig.network import Frame, NmtCommand, NmtState

_TARGET = {
    NmtCommand.START: NmtState.OPERATIONAL,
    NmtCommand.STOP: NmtState.STOPPED,
    NmtCommand.ENTER_PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
}
_ON_ERROR = {0: NmtState.PRE_OPERATIONAL, 2: NmtState.STOPPED}  # 0x1029 sub 1; 1: no change


class Nmt:
    """Holds the state. `enter(state)` is the device's: it changes what is let through; `reset(node)` restarts it."""

    def __init__(self, node_id: int, enter: Callable[[NmtState], None], reset: Callable[[bool], None]) -> None:
        self.state = NmtState.INITIALISING
        self._addressed = (0, node_id)  # 0: all nodes
        self._enter, self._reset = enter, reset

    def receive(self, frame: Frame) -> None:
        """The frame 0x000: command, node. Anything malformed or for another node is ignored."""
        if len(frame.data) != 2 or frame.data[1] not in self._addressed:
            return
        command = frame.data[0]
        if command in (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION):
            self._reset(command == NmtCommand.RESET_NODE)
        elif command in _TARGET:
            self._enter(_TARGET[NmtCommand(command)])

    def communication_error(self, behaviour: int) -> None:
        """A communication error came up; `behaviour` is 0x1029 sub 1. Only an operational device reacts."""
        if self.state is NmtState.OPERATIONAL and behaviour in _ON_ERROR:
            self._enter(_ON_ERROR[behaviour])
