"""The names that other folders use, each imported at its first use."""

from .bus import (
    EmbeddedWire as EmbeddedWire,
    Link as Link,
    LinkWire as LinkWire,
    Wire as Wire,
    can_open as can_open,
    choose_bus as choose_bus,
    open_can as open_can,
    serve_node as serve_node,
)
from .frame import (
    Clock as Clock,
    Frame as Frame,
    Node as Node,
    Send as Send,
    VirtualClock as VirtualClock,
    WallClock as WallClock,
    find_cob_id as find_cob_id,
    make_message as make_message,
)
from .heartbeat import HeartbeatConsumer as HeartbeatConsumer, HeartbeatProducer as HeartbeatProducer
from .master import (
    HEARTBEAT_LIMIT as HEARTBEAT_LIMIT,
    PATIENT as PATIENT,
    BusError as BusError,
    Master as Master,
    StartTime as StartTime,
)
from .node_objects import (
    CONTROLLER as CONTROLLER,
    COUNTERS as COUNTERS,
    CYCLE_RECORD as CYCLE_RECORD,
    GAINS as GAINS,
    NAMES as NAMES,
    PLANT as PLANT,
    RIG as RIG,
    RING as RING,
    SCENARIO as SCENARIO,
    CycleRecord as CycleRecord,
    Gains as Gains,
    Identity as Identity,
    NmtCommand as NmtCommand,
    NmtState as NmtState,
    encode_cycle_record as encode_cycle_record,
    name_state as name_state,
    read_gains as read_gains,
)
from .raw_bus import (
    FRAME as FRAME,
    PAYLOAD_IN as PAYLOAD_IN,
    PAYLOAD_OUT as PAYLOAD_OUT,
    QUEUE_FULL as QUEUE_FULL,
    SENT as SENT,
    TIMEOUT as TIMEOUT,
    Port as Port,
    RawBus as RawBus,
    await_frame as await_frame,
    make_closed_port as make_closed_port,
    read_clock as read_clock,
    receive_frame as receive_frame,
    send_frame as send_frame,
    send_payload as send_payload,
    sleep_until as sleep_until,
)
from .sdo_client import (
    ABORT as ABORT,
    HEAD as HEAD,
    SdoProblem as SdoProblem,
    download_object as download_object,
    pack_segment as pack_segment,
    require_confirmation as require_confirmation,
    upload_object as upload_object,
)
