"""Project a known object into every camera of a rig."""

import imgcal

rig = imgcal.load_rig("O10")  # ten cameras on a circle; a name of a shipped rig or a path
obj = imgcal.load_object("asymmetric8")
points_rig = obj.points + obj.points.new_tensor((0.0, 0.0, rig.working_distance))

seen = rig.project(points_rig)
print("pixels of fiducial 0 in each camera:")
print(seen.uv[:, 0])  # (10 cameras, 2)
print("all visible:", bool(seen.visible.all()))
