"""The names that other folders use, each imported at its first use."""

from .compare_report import build_comparison_report as build_comparison_report
from .diagnosis_report import (
    LEVEL_MOODS as LEVEL_MOODS,
    LEVEL_NAMES as LEVEL_NAMES,
    VERDICT_MOODS as VERDICT_MOODS,
    FoundFault as FoundFault,
    build_bands_report as build_bands_report,
    build_diagnosis_report as build_diagnosis_report,
    collect_diagnosis_data as collect_diagnosis_data,
    list_found_faults as list_found_faults,
)
from .diff_report import build_diff_report as build_diff_report, choose_difference_units as choose_difference_units
from .drawing import (
    BLUE as BLUE,
    COMMAND as COMMAND,
    GREEN as GREEN,
    INK as INK,
    RED as RED,
    Drawing as Drawing,
    Mark as Mark,
    axes as axes,
    call as call,
    choose_drawn_unit as choose_drawn_unit,
    convert_figure as convert_figure,
    draw_panels as draw_panels,
    instant as instant,
    label_signal as label_signal,
    save_drawing as save_drawing,
)
from .explain_report import (
    build_explanation_report as build_explanation_report,
    build_model_report as build_model_report,
)
from .identify_report import build_identification_report as build_identification_report
from .import_report import build_guess_report as build_guess_report, build_import_report as build_import_report
from .numbers import (
    NO_NUMBER as NO_NUMBER,
    choose_unit as choose_unit,
    format_amount as format_amount,
    format_digits as format_digits,
    format_duration as format_duration,
    format_ratio as format_ratio,
    join_words as join_words,
    list_first as list_first,
)
from .report import (
    Cell as Cell,
    Column as Column,
    Figure as Figure,
    Item as Item,
    Line as Line,
    Medium as Medium,
    Mood as Mood,
    Paragraph as Paragraph,
    Report as Report,
    Section as Section,
    Table as Table,
    render_html as render_html,
    tabulate as tabulate,
    to_plain as to_plain,
    write_html as write_html,
)
from .run_report import (
    MOODS as MOODS,
    build_run_report as build_run_report,
    draw_failed_check as draw_failed_check,
    draw_signals as draw_signals,
    list_faults as list_faults,
    read_verdict as read_verdict,
    write_run_page as write_run_page,
)
from .terminal import format_report as format_report, print_report as print_report, style_of as style_of
from .trend_report import build_trend_report as build_trend_report, draw_trends as draw_trends
