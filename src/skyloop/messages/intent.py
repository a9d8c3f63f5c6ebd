"""What became of what an application asked for: told in each feedback, so that a lost packet does not matter."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Final

import msgspec

from skyloop.messages.fields import Refusal
from skyloop.messages.numbers import Count

MAX_OUTCOME_TEXT: Final = 300  #: characters


class Fate(StrEnum):
    """How far an intent is, or what ended it. Nothing that is over is ever done again by a repeat."""

    UNDER_WAY = "under_way"
    COMPLETED = "completed"
    REFUSED = "refused"
    REPLACED = "replaced"
    WITHDRAWN = "withdrawn"
    TIMED_OUT = "timed_out"
    LANDED = "landed"
    EMERGENCY = "emergency"
    AUTHORITY = "authority"
    LINK = "link"
    FAILSAFE = "failsafe"
    OTHERS = "others"
    SLEPT = "slept"
    JUMPED = "jumped"


#: The one list of what ends an intent, in words for people; ``docs/proxy.md`` has it, too.
ENDINGS: Final[dict[Fate, str]] = {
    Fate.COMPLETED: "it was done",
    Fate.REFUSED: "it was refused",
    Fate.REPLACED: "a newer command took its place",
    Fate.WITHDRAWN: "its application wants it no more: the call was cancelled, failed, or ran out of time",
    Fate.TIMED_OUT: "the vehicle did not leave the ground within 20 s, or one that was to land was not heard for 60 s",
    Fate.LANDED: "the vehicle landed or disarmed, whoever made it",
    Fate.EMERGENCY: "there was an emergency, or somebody stopped the motors",
    Fate.AUTHORITY: "the authority was granted anew, lost or given back",
    Fate.LINK: "the link to the vehicle broke or came back, which ends no landing, or the application's own was lost",
    Fate.FAILSAFE: "a failsafe took over",
    Fate.OTHERS: "somebody else took the vehicle",
    Fate.SLEPT: "the proxy's computer slept",
    Fate.JUMPED: "the vehicle's position jumped",
}


class Outcome(msgspec.Struct, frozen=True, array_like=True):
    """What became of the newest intent of the application that commands, or commanded last."""

    app_id: Count = 0  #: number of the application in this run of the proxy; 0: nobody has commanded yet
    intent: Count = 0  #: the number of the intent, as in its commands
    fate: Fate = Fate.UNDER_WAY
    reason: Refusal | None = None  #: why it, or a repeat of it, is refused
    text: Annotated[str, msgspec.Meta(max_length=MAX_OUTCOME_TEXT)] = ""  #: the same for a person

    @property
    def over(self) -> bool:
        """Whether it ended."""
        return self.fate is not Fate.UNDER_WAY

    @property
    def failed(self) -> bool:
        """Whether it ended otherwise than by being done."""
        return self.over and self.fate is not Fate.COMPLETED
