"""Which blob is which fiducial, for the unlabelled blobs of all cameras together."""

from imgcal.identity.identify import bootstrap, identify, track
from imgcal.identity.orientation import oriented
from imgcal.identity.result import Identity, IdentityOptions, Status

__all__ = ["Identity", "IdentityOptions", "Status", "bootstrap", "identify", "oriented", "track"]
