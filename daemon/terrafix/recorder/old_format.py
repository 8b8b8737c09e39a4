"""Messages of records that were written before their types and fields were renamed."""

from dataclasses import dataclass, field

import msgspec

from terrafix.messages import CalibrationEstimate, EkfDeadReckoning, EkfStatus, Message


@dataclass(frozen=True)
class OldType:
    """A renamed message type, and new names of its fields by the old ones."""

    type: type[Message]
    fields: dict[str, str] = field(default_factory=dict)

    def decode(self, data: bytes) -> Message:
        """``data``: JSON of the old form. Raises msgspec.MsgspecError."""
        old = msgspec.json.decode(data, type=dict[str, msgspec.Raw])
        renamed = {self.fields.get(name, name): value for name, value in old.items() if name != "type"}
        return msgspec.json.decode(msgspec.json.encode({"type": self.type.__name__, **renamed}), type=self.type)


# By the topic of the old name. Records of terrafix-flight/1 have them until the names of 0.1.0.
OLD_TOPICS: dict[str, OldType] = {
    "/coasted": OldType(EkfDeadReckoning, {"coast_s": "duration_s", "way_m": "delta_p_m", "gain_mps": "delta_v_mps"}),
    "/slow_errors": OldType(CalibrationEstimate, {"error": "state"}),
    "/filter_status": OldType(EkfStatus),
}
