from .address import Address, parse_address
from .commands import Action, Command
from .demonstration import Demonstration
from .live_page import LivePage
from .page import content_policy, to_json
from .rig_drawing import up_and_forward
from .security import Gate

__all__ = [
    "Action",
    "Address",
    "Command",
    "Demonstration",
    "Gate",
    "LivePage",
    "content_policy",
    "parse_address",
    "to_json",
    "up_and_forward",
]
