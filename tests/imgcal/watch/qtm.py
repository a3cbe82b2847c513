"""A small server that speaks the 2D part of QTM's real-time protocol and sends given data."""

import socket
import struct
import threading
import time

import numpy as np


def packet(kind, body):
    return struct.pack("<II", 8 + len(body), kind) + body


def frame(number, cameras, stamp=None, kind=7):
    """A data packet: for each camera (K, 2) pixels, which become whole 64ths."""
    inside = struct.pack("<Ihh", len(cameras), 0, 0)
    for uv in cameras:
        places = np.round(np.asarray(uv).reshape(-1, 2) * 64).astype(int)
        inside += struct.pack("<iB", len(places), 0) + b"".join(struct.pack("<iiHH", x, y, 300, 310) for x, y in places)
    component = struct.pack("<II", 8 + len(inside), kind) + inside
    return packet(3, struct.pack("<qII", number * 10_000 if stamp is None else stamp, number, 1) + component)


def general(serials, sizes, fov=None):
    """The answer to GetParameters General."""
    cameras = ""
    for number, (serial, (width, height)) in enumerate(zip(serials, sizes, strict=True), 1):
        left, top, right, bottom = fov or (0, 0, width - 1, height - 1)
        cameras += (
            f"<Camera><ID>{number}</ID><Model>Miqus M3</Model><Serial>{serial}</Serial><Mode>Marker</Mode>"
            f"<Marker_Res><Width>{width * 64}</Width><Height>{height * 64}</Height></Marker_Res><Marker_FOV>"
            f"<Left>{left}</Left><Top>{top}</Top><Right>{right}</Right><Bottom>{bottom}</Bottom></Marker_FOV></Camera>"
        )
    return f"<QTM_Parameters_Ver_1.20><General><Frequency>100</Frequency>{cameras}</General></QTM_Parameters_Ver_1.20>"


class Qtm:
    """Gives each connection the next of several streams, the last one again and again; then closes it.

    A stream is bytes, which are sent at once, or pairs of seconds since the beginning and bytes that are sent then.
    """

    def __init__(self, parameters, *streams, answer=None):
        self.parameters, self.streams, self.answer = parameters, streams, answer
        self.began = None
        self.commands, self.connections = [], 0
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.address = f"qtm://127.0.0.1:{self._listening.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._listening.close()

    def _serve(self):
        while True:
            try:
                connection, _ = self._listening.accept()
            except OSError:
                return
            stream = self.streams[min(self.connections, len(self.streams) - 1)]
            self.connections += 1
            try:
                with connection:
                    self._answer(connection, stream)
            except OSError:
                pass  # whoever was connected has gone

    def _answer(self, connection, stream):
        connection.sendall(packet(1, b"QTM RT Interface connected\0"))
        asked = b""
        while asked.count(b"\0StreamFrames") + asked.count(b"StreamFrames AllFrames 2D\0") == 0:
            asked += connection.recv(4096)
        self.commands.append(asked)
        if self.answer is not None:
            connection.sendall(self.answer)
            return
        xml = packet(2, self.parameters.encode() + b"\0")
        connection.sendall(packet(1, b"Version set to 1.20\0") + xml + packet(6, b"\x03"))
        self.began = time.monotonic() if self.began is None else self.began
        for seconds, part in [(0.0, stream)] if isinstance(stream, bytes) else stream:
            time.sleep(max(0.0, self.began + seconds - time.monotonic()))
            for at in range(0, len(part), 7001):  # wherever a packet ends
                connection.sendall(part[at : at + 7001])
