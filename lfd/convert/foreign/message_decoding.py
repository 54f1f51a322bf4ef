"""Messages of other programs as objects: ROS 2 CDR, protobuf and JSON. The only module that imports their decoders.

A type is known from the definition that the file carries, so that nothing of ROS or Foxglove needs to be installed,
and only the topics that a recipe maps are decoded: one that cannot be does not sink a file.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

from google.protobuf.message import DecodeError, Message
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoders
from mcap_ros2.decoder import DecoderFactory as Ros2Decoders

from lfd.core.errors import RecordingError
from lfd.record.mcap_file import DAMAGE, Topic

ENCODINGS = {
    "cdr": "ROS 2 CDR with its definition as ros2msg",
    "protobuf": "protobuf with its descriptors",
    "json": "JSON",
}
"""What is read, as messages say it."""
CDR_HEADERS = (b"\x00\x00", b"\x00\x01")
"""Plain CDR, big and little endian. XCDR2 aligns differently and would be read wrong."""
UNDECODABLE = (*DAMAGE, DecodeError, IndexError, TypeError, AttributeError, NotImplementedError, RecursionError)
"""What damaged bytes can make a decoder raise."""


@dataclass(frozen=True)
class Decoder:
    """From the bytes of a message to an object whose members are attributes."""

    decode: Callable[[bytes], Any]
    members: Callable[[Any], tuple[str, ...]]
    """Names of a value's members in the order of the definition; none for a number, text or array."""


@dataclass(frozen=True)
class _Schema:
    """What the decoders of the mcap project ask of a definition."""

    id: int
    name: str
    encoding: str
    data: bytes


def decoder_of(topic: Topic, where: str) -> Decoder:
    """The decoder of a topic's messages.

    Raises `RecordingError`, beginning with `where` (file and topic), for an encoding or definition that is not read.
    """
    return _decoder(topic.encoding, topic.schema, topic.schema_encoding, topic.definition, where)


@lru_cache(maxsize=64)
def _decoder(encoding: str, schema: str, schema_encoding: str, definition: bytes, where: str) -> Decoder:
    if encoding == "json":
        return Decoder(_json, _members_of_namespace)
    told = f"{schema or 'no type'} in {encoding or 'no known encoding'}, its definition in {schema_encoding or 'none'}"
    factories: dict[str, Callable[[], Any]] = {"cdr": Ros2Decoders, "protobuf": ProtobufDecoders}
    if encoding not in factories:
        raise RecordingError(
            f"{where} is {told}; lfd reads {', '.join(ENCODINGS.values())}; convert the file, or leave the topic out"
        )
    try:
        decode = factories[encoding]().decoder_for(encoding, _Schema(1, schema, schema_encoding, definition))
    except Exception as error:  # the parser of definitions has errors of its own, private, without a common base
        raise RecordingError(
            f"{where} has a definition of {schema} that cannot be read ({_reason(error)}); leave the topic out"
        ) from error
    if decode is None:
        raise RecordingError(f"{where} is {told}; lfd reads {ENCODINGS[encoding]}; leave the topic out")
    return (
        Decoder(_plain_cdr(decode), _members_of_slots) if encoding == "cdr" else Decoder(decode, _members_of_protobuf)
    )


def decode_message(decoder: Decoder, data: bytes, where: str, time_ns: int) -> Any:
    """A message as an object.

    Raises `RecordingError` with file and topic (`where`) and log time for bytes that are none of the type.
    """
    try:
        return decoder.decode(data)
    except UNDECODABLE as error:
        raise RecordingError(
            f"{where} cannot be decoded at log time {log_time(time_ns)} ({_reason(error)}); "
            "leave the recording out (--skip-bad)"
        ) from error


def log_time(time_ns: int) -> str:
    """A log time [s] with all its digits."""
    return f"{time_ns // 10**9}.{time_ns % 10**9:09d}"


def _reason(error: Exception) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def _plain_cdr(decode: Callable[[bytes], Any]) -> Callable[[bytes], Any]:
    def checked(data: bytes) -> Any:
        if data[:2] not in CDR_HEADERS:
            raise ValueError(f"encapsulation {data[:2].hex()}, expected 0001 or 0000 (plain CDR)")
        return decode(data)

    return checked


def _json(data: bytes) -> Any:
    return json.loads(data, object_hook=lambda members: SimpleNamespace(**members))


def _members_of_namespace(value: Any) -> tuple[str, ...]:
    return tuple(vars(value)) if isinstance(value, SimpleNamespace) else ()


def _members_of_slots(value: Any) -> tuple[str, ...]:
    return tuple(value.__slots__) if isinstance(value, SimpleNamespace) else ()


def _members_of_protobuf(value: Any) -> tuple[str, ...]:
    return tuple(value.DESCRIPTOR.fields_by_name) if isinstance(value, Message) else ()
