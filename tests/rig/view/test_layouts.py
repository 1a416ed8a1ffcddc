"""The layouts for Foxglove and PlotJuggler: every path is in the log of a real run, and every panel in the layout."""
from __future__ import annotations

import json
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from places import ROOT

FOLDER = ROOT / "docs" / "viewers"
Fields = dict[str, set[str]]  # topic -> names of its fields
SCALES = {"mm": 1e3, "mA": 1e3, "bar": 1e-5, "um": 1e6, "N": 1.0, "us": 1e6}  # of the units in titles, from SI


@pytest.fixture(scope="module")
def topics(preflight: Path) -> tuple[Fields, Fields]:
    """Topic -> all fields, and those that are numbers, of the messages in the log."""
    every: Fields = {}
    numbers: Fields = {}
    with (preflight / "trace.mcap").open("rb") as file:
        for _, channel, _, message in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            if channel.topic not in every:
                fields = message.DESCRIPTOR.fields
                every[channel.topic] = {field.name for field in fields}
                kinds = {field.name: type(getattr(message, field.name)) for field in fields}
                numbers[channel.topic] = {name for name, kind in kinds.items() if kind in (float, int, bool)}
    return every, numbers


def list_panels(layout: Any) -> list[str]:
    """The panels of a Foxglove layout, from its tree of splits."""
    if isinstance(layout, str):
        return [layout]
    assert layout["direction"] in ("row", "column") and 0 < layout["splitPercentage"] < 100
    return list_panels(layout["first"]) + list_panels(layout["second"])


def test_foxglove_paths_are_in_the_log(topics: tuple[Fields, Fields]) -> None:
    layout = json.loads((FOLDER / "eha.foxglove.json").read_text())
    panels = list_panels(layout["layout"])
    assert len(panels) == len(set(panels)) and set(panels) == set(layout["configById"])
    every, numbers = topics
    shown = set()
    for name, panel in layout["configById"].items():
        if "topicPath" in panel:
            assert panel["topicPath"] in every
            shown.add(panel["topicPath"])
        for path in panel.get("paths", []):
            found = re.fullmatch(r"(/\w+)(?:\{(\w+)==\d+\})?\.(\w+)(?:\.@mul\(([\d.]+)\))?", path["value"])
            assert found, path["value"]
            topic, chosen, field, factor = found.groups()
            assert field in every[topic] and (chosen is None or chosen in numbers[topic])
            shown.add(topic)
            if name.startswith("Plot!"):
                unit = re.search(r"\[(.*)\]", panel["foxglovePanelTitle"])
                assert field in numbers[topic] and unit and float(factor or 1.0) == SCALES[unit[1]]
    assert shown == set(every) - {"/can"}


def test_plotjuggler_curves_are_in_the_log(topics: tuple[Fields, Fields]) -> None:
    root = ElementTree.parse(FOLDER / "eha.plotjuggler.xml").getroot()
    _, numbers = topics
    curves = 0
    for area in root.iter("DockArea"):
        unit = re.search(r"\[(.*)\]", area.attrib["name"])
        for curve in area.iter("curve"):
            topic, field = re.fullmatch(r"(/\w+)/(\w+)", curve.attrib["name"]).groups()  # type: ignore[union-attr]
            assert field in numbers[topic]
            options = curve.find("transform[@name='Scale/Offset']/options")
            scale = 1.0 if options is None else float(options.attrib["value_scale"])
            assert scale == (SCALES[unit[1]] if unit else 1.0), area.attrib["name"]
            curves += 1
    assert curves > 10
    for splitter in root.iter("DockSplitter"):
        assert len(splitter) == int(splitter.attrib["count"]) == len(splitter.attrib["sizes"].split(";"))


def test_every_signal_is_in_both_layouts() -> None:
    for file in ("eha.foxglove.json", "eha.plotjuggler.xml"):
        text = (FOLDER / file).read_text()
        assert all(re.search(rf"/signals[./]{name}\b", text) for name in ("com", "xj", "cor", "p12", "xs", "load"))


def test_the_page_names_the_topics_and_fields(topics: tuple[Fields, Fields]) -> None:
    page = (ROOT / "docs" / "viewers.md").read_text()
    rows = {topic: set(re.findall(r"`(\w+)`", text)) for topic, text in
            re.findall(r"^\| `(/\w+)` \|[^|]*\|(.*)\|$", page, re.MULTILINE)}
    every, _ = topics
    assert set(rows) == set(every)
    for topic, named in rows.items():
        assert named == every[topic] if topic != "/checks" else named < every[topic]


def test_times_in_the_log_are_dates(preflight: Path) -> None:
    with (preflight / "trace.mcap").open("rb") as file:
        times = [(message.log_time, message.publish_time) for _, _, message in make_reader(file).iter_messages()]
    assert all(logged == published for logged, published in times)
    written = datetime.fromtimestamp((preflight / "trace.mcap").stat().st_mtime, UTC)
    started = datetime.fromtimestamp(times[0][0] * 1e-9, UTC)
    assert abs((written - started).total_seconds()) < 86400.0  # lockstep runs ahead of the clock by less than that
