"""Options for captures that are refused."""

from imgcal.association import IdentityOptions, PipelineOptions

SHORT = PipelineOptions(identity=IdentityOptions(rounds=6))
"""Where a refusal looks for its cause, no pose is found in most of the readings that it tries. Each of these searches
would make 24 rounds; in snapshots with few false blobs, a pose that there is comes up in the first or the second."""
