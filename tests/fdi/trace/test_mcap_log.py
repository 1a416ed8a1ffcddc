"""Columns of a log read through the chunk index equal those that protobuf's own parser reads."""
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType, Writer
from synthetic_run import record_run

from fdi.trace.mcap_log import Log, open_log


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    return open_log(record_run(tmp_path_factory.mktemp("run") / "trace.mcap"))


def rewrite(log: Log, path: Path, index_types: IndexType) -> Log:
    """The rows of a log, written by the libraries: fields that are 0 are left out, as proto3 does."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=10_000, compression=CompressionType.ZSTD, index_types=index_types)
        writer.start()
        for channel in log.channels.values():
            schema = log.schemas[channel.schema_id]
            number = writer.register_channel(channel.topic, channel.message_encoding,
                                             writer.register_schema(schema.name, schema.encoding, schema.data))
            for _, time_ns, message in log.read_messages(channel.topic):
                writer.add_message(number, time_ns, message.SerializeToString(), time_ns)
        writer.finish()
    return open_log(path)


@pytest.mark.parametrize("topic", ["/signals", "/timing"])
def test_columns_equal_the_parsed_messages(log: Log, topic: str) -> None:
    columns = log.read_columns(topic)
    messages = [(time_ns, message) for _, time_ns, message in log.read_messages(topic)]
    assert len(messages) > 100
    assert columns["time_ns"].tolist() == [time_ns for time_ns, _ in messages]
    for name in columns.keys() - {"time_ns"}:
        np.testing.assert_array_equal(columns[name], [getattr(message, name) for _, message in messages])


@pytest.mark.parametrize("index_types", [IndexType.ALL, IndexType.ALL & ~IndexType.MESSAGE], ids=["index", "no index"])
def test_columns_of_another_writer_are_the_same(log: Log, tmp_path: Path, index_types: IndexType) -> None:
    other = rewrite(log, tmp_path / "other.mcap", index_types)
    for topic in ("/signals", "/timing"):
        expected = log.read_columns(topic)
        found = other.read_columns(topic)
        assert found.keys() == expected.keys()
        for name, values in expected.items():
            np.testing.assert_array_equal(found[name], values)


def test_a_topic_without_numbers_alone_is_read_too(log: Log) -> None:
    columns = log.read_columns("/events")
    assert len(columns["text"]) == len(list(log.read_messages("/events"))) > 0
    assert len(log.read_columns("/nothing")["time_ns"]) == 0
