from .address import Address, is_host, parse_address
from .commands import Action, Command
from .demonstration import Demonstration
from .live_page import LivePage
from .page import read_asset, render_page, to_json, viewer_script
from .rig_drawing import frustum_length, frustums, up_and_forward
from .security import Gate

__all__ = [
    "Action",
    "Address",
    "Command",
    "Demonstration",
    "Gate",
    "LivePage",
    "frustum_length",
    "frustums",
    "is_host",
    "parse_address",
    "read_asset",
    "render_page",
    "to_json",
    "up_and_forward",
    "viewer_script",
]
