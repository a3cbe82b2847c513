"""Which blob is which fiducial, for the unlabelled blobs of all cameras together."""

from imgcal.association.identify import bootstrap, identify, track
from imgcal.association.orientation import oriented
from imgcal.association.result import Identity, IdentityOptions, Status

__all__ = ["Identity", "IdentityOptions", "Status", "bootstrap", "identify", "oriented", "track"]
