from .address import Address, parse_address
from .commands import Action, Command
from .demonstration import Demonstration
from .live_page import LivePage

__all__ = [
    "Action",
    "Address",
    "Command",
    "Demonstration",
    "LivePage",
    "parse_address",
]
