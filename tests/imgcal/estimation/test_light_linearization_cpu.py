"""Lights in one loop, against a rigid object of one fiducial and against dense derivatives."""
