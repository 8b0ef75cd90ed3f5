"""Limits and time-outs of trust.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import KIB, MIB

# Modules whose rules are cached: as many as a mesh can have (``PEERS_MAX``).
MODULES_REMEMBERED: Final = 4096

# Bytes of an HMAC-SHA256 that are sent, half of it (RFC 2104, section 5): forging one takes 2¹²⁸ attempts.
TAG_BYTES: Final = 16
# A group key is as long as the hash (RFC 2104, section 3).
GROUP_KEY_BYTES: Final = 32
# Numbers below the highest one of a run that are still accepted once (RFC 4303, section 3.4.3): multicasts over
# Wi-Fi are overtaken by unicasts.
REPLAY_WINDOW: Final = 64
# Numbers by which a packet may be ahead of the highest one of its run: else one packet with the highest number
# of all would make each later one of that run an old one.
REPLAY_LEAP: Final = 4096
# Further such numbers for each second since the run was heard: an agent sends some 600 packets a second at most, so
# that one which was out of reach for days is heard again.
REPLAY_LEAP_RATE: Final = 1024.0
# Runs of agents whose numbers are remembered: two of each member of a full roster, as in a rotation of the group
# key. The one that was silent for longest is forgotten first.
RUNS_MAX: Final = 8192
# Difference of two set clocks above which a packet counts as an old one that is sent again. NTP holds 10 ms, a watch
# set by hand 10 s.
CLOCK_TOLERANCE: Final = 30.0
# Group keys that are known: the one that signs, the next, and older ones, with which a module that was away is
# recognised.
KEYS_MAX: Final = 8
# A new group key signs this long after it was made; by then it has reached every linked module. One that a
# revocation made signs at once.
KEY_SPREAD: Final = 30.0
# The group key before verifies for this long after the next one began to sign, unless a revocation made that one.
KEY_OVERLAP: Final = 3600.0
# Runs, and addresses, of modules with an older group key that are remembered; beyond it they are forgotten, and
# heard again.
OLD_KEYS_MAX: Final = 256
# Packets a second with an older group key that are read, over all senders: each leads to one packet as an answer,
# 0.2 ms in all.
OLD_KEY_PACKETS_RATE: Final = 50.0
# Such packets a second of one address, a tenth of all: one former member does not keep modules that were away from
# an answer. A module that starts announces itself four times; twenty on one machine have four heartbeats a second.
OLD_KEY_PACKETS_PER_ADDRESS: Final = 5

# Random bytes of a token: 128 bits cannot be guessed.
TOKEN_SECRET_BYTES: Final = 16
# Bytes of the CA's fingerprint in a token: another certificate with this one takes 2¹²⁸ attempts.
FINGERPRINT_BYTES: Final = 16
# Validity of a token, unless a user says otherwise: the way from one machine to the other.
TOKEN_LIFETIME: Final = 900.0
# [Agent] Time for which a token of `rmpa trust invite` is valid
# At it: the command fails
# Told in: its error
# Why: For the delivery of a robot.
TOKEN_LIFETIME_MAX: Final = 30 * 86_400.0
# Tokens of one authority that are remembered, used ones too; the one that ended first is forgotten first.
TOKENS_MAX: Final = 256
# Characters of a token that are read; one has 91.
TOKEN_TEXT_MAX: Final = 256
# Bytes of one message of a joining module: a request for a certificate in base64 is 6 KiB at most.
JOIN_REQUEST_MAX: Final = 16 * KIB
# Bytes of one message of the authority: two signed documents in base64.
JOIN_ANSWER_MAX: Final = 1 * MIB

# For each step of a join or renewal: connecting with the TLS handshake, and question with answer.
JOIN_STEP_TIMEOUT: Final = 10.0
# Modules whose last certificate the authority remembers, two for each member of a full roster.
ISSUED_MAX: Final = 1024

# Validity of a module's certificate. It bounds how long a stolen key is of use where no deny list arrives.
CERTIFICATE_LIFETIME: Final = 7 * 86_400
# A certificate begins this long before it is issued: clocks of new modules are late.
CERTIFICATE_BACKDATE: Final = 3600
# Validity of a CA: ten years, the life of a robot.
CA_LIFETIME: Final = 3652 * 86_400
# Part of a certificate's validity after which it is renewed; three and a half days are left for the authority to
# be there.
RENEWAL_SHARE: Final = 0.5
# A certificate that ended less than this long ago is renewed without a new invitation: a robot was in a drawer.
RENEWAL_GRACE: Final = 365 * 86_400
# Until a renewal that failed is tried again; each further time it is twice as long.
RENEWAL_RETRY_FIRST: Final = 60.0
# The longest such time.
RENEWAL_RETRY_CAP: Final = 3600.0
# Renewals a second of one linked module at the authority: each is a signature and a file that is synced.
RENEWALS_RATE: Final = 1 / 60
# Renewals of one linked module at once: a user may call ``rmpa trust renew`` again.
RENEWALS_BURST: Final = 4
# How often an agent looks whether its certificate is to be renewed: the wall clock may be set at any time.
RENEWAL_LOOK: Final = 30.0
# A certificate that ends within this time is a warning: renewals have failed for a day and a half.
EXPIRY_NEAR: Final = 2 * 86_400
# A clock before 2025 is not set: a new mesh would have certificates that no other machine accepts.
EARLIEST_TIME: Final = 1_735_689_600
# Bytes of a request for a certificate (DER); one has some 250.
CSR_MAX: Final = 4 * KIB
# [Graph] Names and addresses in a module's certificate for its page, besides its own
# At it: the browser warns at further ones
PAGE_HOSTS_MAX: Final = 16
# Bytes of a certificate (DER or PEM) that are parsed; one has some 600.
CERTIFICATE_MAX: Final = 8 * KIB

# [Agent] Names of revoked modules
# At it: `rmpa trust revoke` fails; make a new mesh
# Told in: its error
# Why: Two for each member of a full roster.
DENY_MAX: Final = 1024
# Bytes of a signed document: a full deny list has some 100 KB.
DOCUMENT_MAX: Final = 256 * KIB
