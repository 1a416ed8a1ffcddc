"""The layouts for Foxglove and PlotJuggler: every path is in the log of a real run, and every panel in the layout."""

import json
import re
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
    with (preflight / "trace.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        last = {channel.topic: message for _, channel, _, message in reader.iter_decoded_messages()}
    kinds = {topic: {field.name: type(getattr(message, field.name)) for field in message.DESCRIPTOR.fields}
             for topic, message in last.items()}
    return ({topic: set(fields) for topic, fields in kinds.items()},
            {topic: {name for name, kind in fields.items() if kind in (float, int, bool)}
             for topic, fields in kinds.items()})


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
    curves = [(area.attrib["name"], curve) for area in root.iter("DockArea") for curve in area.iter("curve")]
    assert len(curves) > 10
    for title, curve in curves:
        topic, field = curve.attrib["name"][1:].split("/")
        options, unit = curve.find("transform[@name='Scale/Offset']/options"), re.search(r"\[(.*)\]", title)
        scale = 1.0 if options is None else float(options.attrib["value_scale"])
        assert field in topics[1][f"/{topic}"] and scale == (SCALES[unit[1]] if unit else 1.0), title
    for splitter in root.iter("DockSplitter"):
        assert len(splitter) == int(splitter.attrib["count"]) == len(splitter.attrib["sizes"].split(";"))


def test_every_signal_is_in_both_layouts() -> None:
    for file in ("eha.foxglove.json", "eha.plotjuggler.xml"):
        shown = set(re.findall(r"/signals[./](\w+)\b", (FOLDER / file).read_text()))
        assert {"com", "xj", "cor", "p12", "xs", "load"} <= shown


def test_the_page_names_the_topics_and_fields(topics: tuple[Fields, Fields]) -> None:
    page = (ROOT / "docs" / "viewers.md").read_text()
    rows = {topic: set(re.findall(r"`(\w+)`", text)) for topic, text in
            re.findall(r"^\| `(/\w+)` \|[^|]*\|(.*)\|$", page, re.MULTILINE)}
    assert rows.pop("/checks") < topics[0]["/checks"]
    assert rows == {topic: fields for topic, fields in topics[0].items() if topic != "/checks"}
