"""Reading and writing files; every problem is an `InputError` of one line, and nothing is ever half-written."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
