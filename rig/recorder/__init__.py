"""The log: MCAP with protobuf channels, written off the loop's thread, salvaged after a crash."""
from rig.recorder.schema import (
    U32,
    CanFrame,
    Event,
    NmtState,
    Record,
    Signals,
    Timing,
    collect_provenance as collect_provenance,
    make_row_record as make_row_record,
    read_epoch_ns as read_epoch_ns,
)
from rig.recorder.writer import CycleBlock, Observer, Recorder, RecorderError

__all__ = ["U32", "CanFrame", "CycleBlock", "Event", "NmtState", "Observer", "Record", "Recorder",
           "RecorderError", "Signals", "Timing"]
