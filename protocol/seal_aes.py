"""Sealing with AES-CCM-8, for confidentiality; needs the extra: pip install fathomlink[aes]."""

from protocol.errors import ConfigError
from protocol.seal import TAG_BYTES

try:
    from cryptography.exceptions import InvalidTag
    from cryptography.hazmat.primitives.ciphers.aead import AESCCM
except ImportError as error:
    raise ConfigError("AES-CCM needs cryptography; type: pip install 'fathomlink[aes]'") from error

NONCE_BYTES = 13


class AesCcmSuite:
    """Encrypts the body and authenticates it with receiver and header.

    The nonce is the counter alone, never sent twice under the key of one direction.
    """

    def protect(self, key: bytes, bound: bytes, body: bytes, counter: int) -> tuple[bytes, bytes]:
        """Return the encrypted body, as long as the body, and the tag."""
        sealed = AESCCM(key, TAG_BYTES).encrypt(_nonce(counter), body, bound)
        return sealed[:-TAG_BYTES], sealed[-TAG_BYTES:]

    def verify(
        self, key: bytes, bound: bytes, body: bytes, counter: int, tag: bytes
    ) -> bytes | None:
        """Return the decrypted body, None when the tag is wrong."""
        try:
            return AESCCM(key, TAG_BYTES).decrypt(_nonce(counter), body + tag, bound)
        except InvalidTag:
            return None


def _nonce(counter: int) -> bytes:
    return counter.to_bytes(NONCE_BYTES, "big")
