"""Messages of a ROS bag by topic: what the library rosbags raises for a damaged one becomes a SourceError."""

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from terrafix.core.errors import SourceError

# What mavros publishes, for bags without definitions [spec: mavros_msgs/msg]
MAVROS = {
    "mavros_msgs/msg/State": "std_msgs/Header header\nbool connected\nbool armed\nbool guided\nbool manual_input\n"
    "string mode\nuint8 system_status\n",
    "mavros_msgs/msg/Altitude": "std_msgs/Header header\nfloat32 monotonic\nfloat32 amsl\nfloat32 local\n"
    "float32 relative\nfloat32 terrain\nfloat32 bottom_clearance\n",
    "mavros_msgs/msg/GimbalDeviceAttitudeStatus": "std_msgs/Header header\nuint8 target_system\n"
    "uint8 target_component\nuint16 flags\ngeometry_msgs/Quaternion q\nfloat32 angular_velocity_x\n"
    "float32 angular_velocity_y\nfloat32 angular_velocity_z\nuint32 failure_flags\n",
}
# What rosbags and its storages raise for damaged files beside their own exceptions.
_BAG_DAMAGE = (
    ArithmeticError, AssertionError, AttributeError, EOFError, LookupError, MemoryError, OSError, RuntimeError,
    TypeError, ValueError, struct.error,
)  # fmt: skip


class BagReader:
    """A context manager. Raises SourceError: rosbags is not installed; the bag is damaged."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            from rosbags.highlevel import AnyReader, AnyReaderError
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ModuleNotFoundError as error:
            raise SourceError(
                f"{path}: reading a bag needs {error.name}; install it with: pip install 'terrafix[rosbag]'"
            ) from None
        self._damage = (*_BAG_DAMAGE, AnyReaderError)
        store = get_typestore(Stores.ROS2_HUMBLE)
        for name, text in MAVROS.items():
            store.register(get_types_from_msg(text, name))
        with self._guarded():
            self._reader: Any = AnyReader([path], default_typestore=store)

    def __enter__(self) -> Self:
        with self._guarded():
            self._reader.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._reader.close()

    def types(self) -> dict[str, str]:
        """Type of each topic."""
        return {connection.topic: connection.msgtype for connection in self._reader.connections}

    def raw(self, topic: str) -> Iterator[tuple[int, str, bytes]]:
        """(time of recording [ns], type, content) of the messages of a topic, in the order of the bag."""
        of = [connection for connection in self._reader.connections if connection.topic == topic]
        with self._guarded():
            found = iter(self._reader.messages(connections=of) if of else ())
        while True:
            with self._guarded():
                entry = next(found, None)
            if entry is None:
                return
            connection, t_ns, content = entry
            yield t_ns, connection.msgtype, bytes(content)

    def decoded(self, content: bytes, message_type: str) -> Any:
        with self._guarded():
            return self._reader.deserialize(content, message_type)

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        try:
            yield
        except self._damage as error:
            said = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise SourceError(f"{self._path}: the bag cannot be read ({said}); is it complete, and indexed?") from None
