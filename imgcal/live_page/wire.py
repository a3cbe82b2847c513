"""Messages between the loop's process and the server's: a kind, then plain values, arrays and bytes.

Only the loop's side writes what is unpickled; the server, which strangers talk to, answers in lines of JSON.
"""

from __future__ import annotations

import pickle
import struct
from asyncio import StreamReader
from typing import Any

HEADER = struct.Struct("<I")


def frame_message(kind: str, content: dict[str, Any]) -> bytes:
    """Encode one message, its length first.

    Examples:
        >>> len(frame_message("state", {})) > HEADER.size
        True
    """
    body = pickle.dumps((kind, content), protocol=pickle.HIGHEST_PROTOCOL)
    return HEADER.pack(len(body)) + body


async def read_message(reader: StreamReader) -> tuple[str, dict[str, Any]]:
    """Wait for the next message.

    Raises:
        asyncio.IncompleteReadError: the other side has ended.
    """
    (length,) = HEADER.unpack(await reader.readexactly(HEADER.size))
    kind, content = pickle.loads(await reader.readexactly(length))
    return kind, content
