"""Who may speak in a swarm: checks the signatures of reports. It needs `cryptography`; docs/SECURITY.md has the form."""

import hashlib
import json
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature

CHALLENGE_BYTES = 16
# What is published answers no question.
PUBLISHED = bytes(CHALLENGE_BYTES)
FORM, SIGNATURE_END, SEAL_END = 1, 65, 73
MOST_KNOWN = 1024
# An observer that was silent for this long must answer anew, seconds.
SILENT_S = 3.0
ASK_AGAIN_S = 0.5
# What was held back for longer is of no use, seconds.
STALE_S = 1.0


class Untrusted(ValueError):
    """What is said is not signed by the observer that its key names; it says why."""


@dataclass(frozen=True)
class Security:
    """A member's files, as `flockeye keys issue` writes them."""

    ca: str
    certificate: str
    key: str
    roster: str

    @classmethod
    def of_folder(cls, folder):
        """Those in a folder."""
        names = ["ca.pem", "certificate.pem", "key.pem", "roster.json"]
        return cls(*(str(Path(folder) / name) for name in names))

    def tls(self):
        """Zenoh's configuration of its links."""
        return {
            "root_ca_certificate": self.ca,
            "enable_mtls": True,
            "connect_private_key": self.key,
            "connect_certificate": self.certificate,
            # Certificates have drones' names, and links have addresses.
            "verify_name_on_connect": False,
            "close_link_on_expiration": True,
        }


class Trust:
    """The authority's word on who belongs to the swarm."""

    def __init__(self, security):
        """Raises Untrusted where the authority has not signed the roster."""
        self._authority = x509.load_pem_x509_certificate(Path(security.ca).read_bytes())
        signed = json.loads(Path(security.roster).read_text())
        self.roster = signed["roster"]
        words = json.dumps(self.roster, separators=(",", ":"), ensure_ascii=False).encode()
        try:
            signature = bytes.fromhex(signed["signature"])
            self._authority.public_key().verify(signature, b"flockeye roster 1\0" + words)
        except InvalidSignature:
            raise Untrusted(f"{security.roster}: the swarm's authority has not signed this") from None
        self._names = {*self.roster["members"], *self.roster["routers"]}
        self._known = {}

    def knows(self, name):
        """Whether somebody of this name belongs to the swarm."""
        return name in self._names

    def check(self, key, payload, attachment, challenge=PUBLISHED):
        """Raises Untrusted unless the observer in `key` has said `payload` there, as the answer to `challenge`."""
        if attachment is None or len(attachment) < SEAL_END or attachment[0] != FORM:
            raise Untrusted("it is not signed")
        certificate = self._certificate(attachment[SIGNATURE_END:SEAL_END], attachment[SEAL_END:])
        now = datetime.now(UTC)
        if not certificate.not_valid_before_utc <= now <= certificate.not_valid_after_utc:
            raise Untrusted("its certificate does not hold now")
        if format(certificate.serial_number, "032x") in self.roster["revoked"]:
            raise Untrusted("its certificate is revoked")
        said = key.encode()
        message = b"".join(
            [b"flockeye report 1\0", len(said).to_bytes(4, "big"), said, challenge, payload]
        )
        try:
            certificate.public_key().verify(attachment[1:SIGNATURE_END], message)
        except InvalidSignature:
            raise Untrusted("its signature does not match what it says") from None
        [name] = certificate.subject.get_attributes_for_oid(x509.NameOID.COMMON_NAME)
        if not self.knows(name.value) or name.value != key.split("/")[2]:
            raise Untrusted(f"it is signed by {name.value!r}")

    def _certificate(self, fingerprint, der):
        if not der:
            if fingerprint not in self._known:
                raise Untrusted("its certificate is not known yet")
            return self._known[fingerprint]
        known = self._known.get(fingerprint)
        if known is not None:
            return known
        try:
            certificate = x509.load_der_x509_certificate(bytes(der))
            certificate.verify_directly_issued_by(self._authority)
        except (ValueError, TypeError, InvalidSignature):
            raise Untrusted("another authority has signed its certificate") from None
        if len(self._known) == MOST_KNOWN:
            self._known.clear()
        self._known[hashlib.sha256(der).digest()[:8]] = certificate
        return certificate


@dataclass
class _Heard:
    """When an observer answered, and what came since; times of its own clock in ns, of this machine's in s."""

    answer_ns: int
    answer_s: float
    newest_ns: int
    newest_s: float


class Presence:
    """Whether observers are there now: whoever was silent must answer a question before it is believed, and what it says
    then is newer than its answer and not held back."""

    def __init__(self):
        self._heard = {}
        self._asked = {}

    def is_silent(self, observer, now_s):
        """Whether nothing was believed of it for a while."""
        heard = self._heard.get(observer)
        return heard is None or now_s - heard.newest_s > SILENT_S

    def answered(self, observer, sent_ns, now_s=None):
        """The observer has answered, at this time of its own clock."""
        now_s = time.monotonic() if now_s is None else now_s
        if self.is_silent(observer, now_s):
            self._heard[observer] = _Heard(sent_ns, now_s, sent_ns, now_s)

    def believes(self, observer, sent_ns, now_s=None):
        """Whether what it published is of now."""
        now_s = time.monotonic() if now_s is None else now_s
        if self.is_silent(observer, now_s):
            return False
        heard = self._heard[observer]
        late_s = now_s - heard.answer_s - (sent_ns - heard.answer_ns) * 1e-9
        if sent_ns <= heard.newest_ns or late_s > STALE_S:
            return False
        heard.newest_ns, heard.newest_s = sent_ns, now_s
        return True

    def needs_question(self, observer, now_s=None):
        """Whether it is silent, and was not asked just now."""
        now_s = time.monotonic() if now_s is None else now_s
        if not self.is_silent(observer, now_s):
            return False
        asked_s = self._asked.get(observer)
        if asked_s is not None and now_s - asked_s < ASK_AGAIN_S:
            return False
        self._asked[observer] = now_s
        return True
