"""Poses for other processes through ZeroMQ: slow listeners miss poses and never block the rig."""

from __future__ import annotations

from imgcal.errors import InputError
from imgcal.messages import shorten
from imgcal.watch.poses import PoseRecord, PoseSink
from imgcal.watch.zeromq import ADDRESS

QUEUED = 1000  # messages kept for a slow subscriber


class PosePublisher(PoseSink):
    """Publishes a line of JSON per snapshot, as written by `PoseRecord.to_json`."""

    def __init__(self, address: str) -> None:
        """Bind to tcp://host:port or ipc://path.

        Raises:
            InputError: the address is in use, or invalid.
        """
        import zmq  # not in the core

        found = ADDRESS.fullmatch(address)
        if found is None or int(found[1] or 0) >= 2**16:  # ZeroMQ would take the port modulo 65536
            raise InputError(f"{shorten(address)}: expected tcp://HOST:PORT or ipc://PATH to publish at")
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.PUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.SNDHWM, QUEUED)
        try:
            self._socket.bind(address)
        except zmq.ZMQError as error:
            self.close()
            raise InputError(f"{shorten(address)}: cannot publish there: {error}") from error

    def send(self, record: PoseRecord) -> None:
        """See `PoseSink`."""
        self._socket.send(record.to_json().encode(errors="replace"))  # a publisher drops messages, and never blocks

    def close(self) -> None:
        """See `PoseSink`."""
        self._socket.close()
        self._context.term()
