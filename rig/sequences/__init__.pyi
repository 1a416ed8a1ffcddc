"""The names that other folders use, each imported at its first use."""

from .checks import (
    Check as Check,
    DriveFrames as DriveFrames,
    Guard as Guard,
    GuardWatch as GuardWatch,
    RunData as RunData,
    SkippedCheck as SkippedCheck,
    evaluate_checks as evaluate_checks,
    find_skipped as find_skipped,
)
from .faults import (
    CUT as CUT,
    DELAY as DELAY,
    DOUBLE as DOUBLE,
    DROP as DROP,
    SENT_NORMALLY as SENT_NORMALLY,
    BusOff as BusOff,
    Corrupted as Corrupted,
    Fault as Fault,
    Foreign as Foreign,
    Frames as Frames,
    Jitter as Jitter,
    Late as Late,
    Noise as Noise,
    Offset as Offset,
    Parameter as Parameter,
    Plan as Plan,
    Reset as Reset,
    Schedule as Schedule,
    Short as Short,
    Silent as Silent,
    Stuck as Stuck,
    change_frame as change_frame,
    is_noticed_by_time as is_noticed_by_time,
    require_possible as require_possible,
    require_sensible as require_sensible,
)
from .protocol import (
    HEARTBEAT as HEARTBEAT,
    Emergency as Emergency,
    Heartbeat as Heartbeat,
    Mask as Mask,
    ProtocolLimits as ProtocolLimits,
    ProtocolRecord as ProtocolRecord,
    Rows as Rows,
    judge_protocol as judge_protocol,
)
from .python_parts import (
    Step as Step,
    StepRun as StepRun,
)
from .sequence import (
    SEGMENT_KINDS as SEGMENT_KINDS,
    Sequence as Sequence,
    TimingPolicy as TimingPolicy,
    list_shipped as list_shipped,
    load_nominal_test as load_nominal_test,
    load_sequence as load_sequence,
    parse_sequence as parse_sequence,
)
from .uncertainty import (
    NO_METROLOGY as NO_METROLOGY,
    Metrology as Metrology,
    collect_metrology as collect_metrology,
)
