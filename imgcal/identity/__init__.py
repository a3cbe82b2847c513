"""Which blob is which fiducial, for the unlabelled blobs of all cameras together."""

from imgcal.identity.identify import bootstrap, identify, track
from imgcal.identity.result import Identity, IdentityOptions

__all__ = ["Identity", "IdentityOptions", "bootstrap", "identify", "track"]
