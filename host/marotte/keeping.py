"""What an MCU keeps on its flash, to play without a host: commands, as `firmware/store.py` carries them out."""

from __future__ import annotations

from marotte.link import pack
from marotte.tables import Message, Tables, items_per_message, weight_q28
from shared import messages

_IDS = {name: message_id for name, message_id, _, _ in messages.MESSAGES}


def kept(tables: Tables, behaviour: str | None = None) -> bytes:
    """Return a puppet and its robot as they are kept: the upload, the weight targets of a behaviour, and the start.

    Each command is a byte with the length of id and payload, its id, and its payload. Raises KeyError if the puppet has no such
    behaviour.
    """
    parts: list[Message] = list(tables.messages())
    if behaviour is not None:
        puppet = tables.puppet
        targets = puppet.behaviours[behaviour].items()
        items = [{"action": puppet.action_index(name), "target_q28": weight_q28(weight)} for name, weight in targets]
        room = items_per_message("weight_targets")
        parts += [("weight_targets", {"frame": 0}, items[at : at + room]) for at in range(0, len(items), room)]
    parts.append(("start", {}, []))
    return b"".join(_record(*part) for part in parts)


def _record(name: str, fields: dict[str, int], items: list[dict[str, int]]) -> bytes:
    payload = pack(name, fields, items)
    return bytes((1 + len(payload), _IDS[name])) + payload
