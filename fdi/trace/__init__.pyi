"""The names that other folders use, each imported at its first use."""

from .check_result import (
    PROTOCOL as PROTOCOL,
    SPEED_SPAN as SPEED_SPAN,
    CheckResult as CheckResult,
    compute_speed as compute_speed,
    describe_field as describe_field,
    filter_median as filter_median,
)
from .command_file import parse_columns as parse_columns, read_command as read_command
from .csv_table import (
    MISSING as MISSING,
    Layout as Layout,
    combine_columns as combine_columns,
    find_own_table as find_own_table,
    is_comment as is_comment,
    is_padded as is_padded,
    make_number_parser as make_number_parser,
    open_text as open_text,
    read_columns as read_columns,
    report_unreadable as report_unreadable,
    require_growth as require_growth,
    split_line as split_line,
)
from .declaration import DECLARATION as DECLARATION, write_declaration as write_declaration
from .mcap_log import (
    BoundedFile as BoundedFile,
    locate_log as locate_log,
    open_log as open_log,
    read_declarations as read_declarations,
    scan_messages as scan_messages,
    unpack_chunk as unpack_chunk,
)
from .sections import (
    Floats as Floats,
    Section as Section,
    describe_section as describe_section,
    find_sections as find_sections,
)
from .sensor_dynamics import (
    SensorDynamics as SensorDynamics,
    find_comb as find_comb,
    is_rounding_left as is_rounding_left,
    measure_resolution as measure_resolution,
    write_sensors as write_sensors,
)
from .trace import (
    MAIN as MAIN,
    Event as Event,
    Flags as Flags,
    Trace as Trace,
    bridge_gaps as bridge_gaps,
    fill_gaps as fill_gaps,
    find_stretches as find_stretches,
    hold_last as hold_last,
    hold_next as hold_next,
    make_table_trace as make_table_trace,
    measure_scale as measure_scale,
    rms as rms,
    shift_rows as shift_rows,
)
