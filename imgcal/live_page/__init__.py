"""One page in a browser on which a running rig is watched: a server in a process of its own, fed by a loop."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
