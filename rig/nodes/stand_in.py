"""The controller that a plant declares, as a node on a bench without a device (`rig.benches.plant_bench`)."""
from __future__ import annotations

from math import nan

from plant import Model
from plant.compile import interpret_function
from plant.model import collect_bindings
from plant.run import report_law_errors
from rig.benches.bench import Bench
from rig.benches.frame_map import Role, make_reader, make_writer
from rig.network.frame import Frame, Send


class StandIn:
    """It answers the last frame of each cycle of the rig with the drive of the plant's law."""

    def __init__(self, send: Send, bench: Bench, model: Model) -> None:
        self._send, self._model, self._record = send, model, model.build_record()[0]
        parts = collect_bindings(model.effects, model.plant)
        self._law = interpret_function(parts["control_plant"], parts)
        self._memory = model.kind.build_control_memory()
        self._readers = {spec.identifier: make_reader(spec) for spec in bench.frames.list_from(Role.RIG)}
        self._last = tuple(self._readers)[-1]
        self._answer, = bench.frames.list_from(Role.CONTROLLER)
        self._write = make_writer(self._answer)
        self._command, self._drive = bench.signals.command.word, bench.signals.drive.word
        self._outputs = [s.word for s in bench.signals.outputs]
        self._values = dict.fromkeys((self._command, *self._outputs), nan)

    def receive(self, frame: Frame) -> None:
        """See `rig.network.frame.Node`."""
        if frame.cob_id not in self._readers:
            return
        self._values |= self._readers[frame.cob_id](frame.data)
        if frame.cob_id == self._last:
            readings = tuple(self._values[word] for word in self._outputs)
            with report_law_errors(self._model):
                drive, self._memory = self._law(self._memory, self._values[self._command], readings, self._record)
            self._send(self._answer.identifier, self._write({self._drive: drive}, 0, 0))

    def tick(self, t_ns: int) -> None:
        """See `rig.network.frame.Node`; it has no clock of its own."""
