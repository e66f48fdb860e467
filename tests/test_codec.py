"""What holds for every schema: an example, a round trip, only ProtocolError from bytes."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from hypothesis import given
from hypothesis import strategies as st

from examples import EXAMPLES, SCAN_KEY, envelope
from facet_protocol import Envelope, ProtocolError, descriptor_set, facet_descriptors
from facet_protocol.codec import SCHEMAS, decode, encode

schemas = pytest.mark.parametrize("schema", SCHEMAS)
TWO_WAY = [name for name in SCHEMAS if name != "foxglove.LaserScan"]  # comes back projected


def test_every_schema_has_an_example() -> None:
    assert EXAMPLES.keys() == SCHEMAS.keys()


@schemas
def test_examples_are_of_their_schema(schema: str) -> None:
    assert encode(EXAMPLES[schema])[0] == schema


@pytest.mark.parametrize("schema", TWO_WAY)
def test_round_trip_keeps_every_bit(schema: str) -> None:
    sent = envelope(EXAMPLES[schema])
    received = decode(replace(sent, payload=memoryview(sent.payload)))
    assert type(received) is type(EXAMPLES[schema])
    assert encode(received) == (schema, sent.payload)


@schemas
def test_every_truncation_gives_a_message_or_a_protocol_error(schema: str) -> None:
    sent = envelope(EXAMPLES[schema])
    for end in range(len(sent.payload)):
        with suppress(ProtocolError):
            decode(replace(sent, payload=sent.payload[:end]))


@schemas
@given(data=st.data())
def test_every_flipped_byte_gives_a_message_or_a_protocol_error(
    schema: str, data: st.DataObject
) -> None:
    sent = envelope(EXAMPLES[schema])
    payload = bytearray(sent.payload)
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    with suppress(ProtocolError):
        decode(replace(sent, payload=bytes(payload)))


@schemas
@given(payload=st.binary(max_size=200))
def test_any_bytes_give_a_message_or_a_protocol_error(schema: str, payload: bytes) -> None:
    with suppress(ProtocolError):
        decode(Envelope(SCAN_KEY, schema, "protobuf", payload))


@pytest.mark.parametrize(
    ("schema", "encoding"), [("facet.v1.Nothing", "protobuf"), ("facet.v1.Cut", "cdr")]
)
def test_an_unknown_schema_or_encoding_is_refused(schema: str, encoding: str) -> None:
    with pytest.raises(ProtocolError) as caught:
        decode(Envelope("k", schema, encoding, b"x"))
    assert caught.value.reason == "unknown_schema"


@pytest.mark.parametrize("schema", [*SCHEMAS, "foxglove.SceneUpdate"])
def test_a_stranger_reads_our_bytes_with_the_descriptor_alone(schema: str) -> None:
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(descriptor_set(schema)).file:
        pool.Add(file)  # fails unless what it imports came before
    message_class = GetMessageClass(pool.FindMessageTypeByName(schema))
    if schema in EXAMPLES:
        payload = encode(EXAMPLES[schema])[1]
        assert message_class.FromString(payload).SerializeToString(deterministic=True) == payload


def test_the_descriptor_of_a_row_is_that_of_its_schema() -> None:
    assert SCHEMAS["facet.v1.Cut"].descriptor == descriptor_set("facet.v1.Cut")
    with pytest.raises(ProtocolError):
        descriptor_set("facet.v1.Nothing")


def test_our_own_schemas_are_all_in_one_set() -> None:
    files = FileDescriptorSet.FromString(facet_descriptors()).file
    names = {f"facet.v1.{m.name}" for file in files for m in file.message_type}
    assert {name for name in SCHEMAS if name.startswith("facet.")} <= names
