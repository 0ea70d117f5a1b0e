"""Files taken apart and put together again, so that a changed byte is not caught by a check sum."""

from __future__ import annotations

import gzip
import io
import struct
import zipfile
import zlib
from collections.abc import Callable

from gsfluent.io.splats.delta import BLOCK, END, INDEX, MAGIC, TRAILER

Parts = list[bytes]
Join = Callable[[Parts], bytes]


def plain(data: bytes) -> tuple[Parts, Join]:
    """A file that is one part."""
    return [data], lambda parts: parts[0]


def archive(data: bytes) -> tuple[Parts, Join]:
    """An ``.npz``: its members."""
    with zipfile.ZipFile(io.BytesIO(data)) as found:
        items = found.infolist()
        members = [found.read(item) for item in items]

    def join(parts: Parts) -> bytes:
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w") as made:
            for item, part in zip(items, parts, strict=True):
                made.writestr(item.filename, part, item.compress_type)
        return stream.getvalue()

    return members, join


def gzipped(data: bytes) -> tuple[Parts, Join]:
    """A file that is packed as a whole."""
    return [gzip.decompress(data)], lambda parts: gzip.compress(parts[0], mtime=0)


def png(data: bytes) -> tuple[Parts, Join]:
    """A PNG: its chunks, the picture unpacked."""
    kinds, parts, at = [], [], 8
    while at < len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        body = data[at + 8 : at + 8 + size]
        kinds.append(kind)
        parts.append(zlib.decompress(body) if kind == b"IDAT" else body)
        at += 12 + size

    def join(parts: Parts) -> bytes:
        out = data[:8]
        for kind, part in zip(kinds, parts, strict=True):
            body = zlib.compress(part) if kind == b"IDAT" else part
            out += struct.pack(">I4s", len(body), kind) + body
            out += struct.pack(">I", zlib.crc32(kind + body))
        return out

    return parts, join


def delta(data: bytes) -> tuple[Parts, Join]:
    """A ``.gsd``: header and payloads; the index follows them unless it is changed itself."""
    version, size = struct.unpack_from("<II", data, 8)
    kinds, parts, at = [], [data[16 : 16 + size]], 16 + size
    while at < len(data) - TRAILER.size:
        kind, frame, packed, _ = BLOCK.unpack_from(data, at)
        kinds.append((kind, frame))
        parts.append(zlib.decompress(data[at + BLOCK.size : at + BLOCK.size + packed]))
        at += BLOCK.size + packed
    index = parts[-1]

    def join(parts: Parts) -> bytes:
        out = bytearray(MAGIC + struct.pack("<II", version, len(parts[0])) + parts[0])
        offsets = []
        for (kind, frame), part in zip(kinds, parts[1:], strict=True):
            offsets.append(len(out))
            if kind == INDEX and part == index:
                part = _index(offsets[:-1])
            body = zlib.compress(part)
            out += BLOCK.pack(kind, frame, len(body), zlib.crc32(body)) + body
        return bytes(out + TRAILER.pack(offsets[-1], END))

    return parts, join


def _index(offsets: list[int]) -> bytes:
    import numpy as np

    from gsfluent.io.splats.delta_write import pack_arrays

    return pack_arrays([np.array([[at & 0xFFFFFFFF, at >> 32] for at in offsets])])
