"""How our logs say whose they are, and the checksum of their metadata, for MCAP has none."""

from __future__ import annotations

import zlib
from collections.abc import Mapping

WRITER = "facet"  # in the header of every log that was written by Facet
RECOVERER = "facet recover"  # and of those that were written again, whoever wrote them first
OWN_METADATA = "facet"  # the record that a log of Facet's begins with: settings, map, frame
METADATA_CRC = "crc32"  # the entry that holds the checksum


def metadata_crc(entries: Mapping[str, str]) -> str:
    """CRC-32 of all entries but its own, in the order of their keys, as eight hex digits."""
    kept = sorted((key, value) for key, value in entries.items() if key != METADATA_CRC)
    text = "".join(f"{key}\0{value}\0" for key, value in kept)
    return f"{zlib.crc32(text.encode('utf-8', 'surrogatepass')):08x}"


def signed(entries: Mapping[str, str]) -> dict[str, str]:
    """The same with their checksum."""
    return {**entries, METADATA_CRC: metadata_crc(entries)}
