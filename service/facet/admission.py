"""Which messages of the log are applied: decoded, in the map's frame, each once. No clock."""

from __future__ import annotations

import hashlib

from facet.sequences import SequenceLedger
from facet.sources.naming import robot_and_sensor, source_of
from facet.status import Account
from facet_protocol.messages import Envelope, ProtocolError, Scan
from facet_protocol.scans import decode_scan
from facet_protocol.topics import PREFIX, parse_scan_key


class Admission:
    """Turns envelopes into scans, in log order, and counts what it leaves out under its reason."""

    def __init__(self, account: Account, frame_id: str, reach_m: float) -> None:
        self._account = account
        self._frame_id, self._reach_m = frame_id, reach_m
        self._applied = SequenceLedger()
        self._unnumbered: set[bytes] = set()  # of scans without a sequence: hashes

    def admit(self, envelope: Envelope) -> Scan | None:
        """The scan to insert; None when it is a duplicate or not a good scan."""
        source = source_of(envelope.key)
        try:
            scan = self._decode(envelope)
        except ProtocolError as error:
            self._account.settle(source, f"rejected.{error.reason}")
            self._account.complain(source, error.reason, str(error))
            return None
        if not self._is_first(envelope, scan.source):
            self._account.settle(source, "duplicate")
            return None
        if scan.renormalised:
            self._account.count("renormalised", source)
        return scan

    def _decode(self, envelope: Envelope) -> Scan:
        if envelope.key.startswith(f"{PREFIX}/"):
            parse_scan_key(envelope.key)  # a name of ours that is none is refused, not mended
        robot, sensor = robot_and_sensor(envelope.key)
        return decode_scan(envelope, robot, sensor, self._reach_m, frame_id=self._frame_id)

    def _is_first(self, envelope: Envelope, source: str) -> bool:
        if envelope.sequence:
            return self._applied.note(source, envelope.epoch, envelope.sequence).is_new
        stamp = envelope.stamp_ns.to_bytes(8, "little", signed=True)
        digest = hashlib.blake2b(source.encode() + stamp, digest_size=16)
        digest.update(envelope.payload)
        known = digest.digest() in self._unnumbered
        self._unnumbered.add(digest.digest())
        return not known
