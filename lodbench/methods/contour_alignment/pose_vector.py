from lodbench.geometry.pose_vector import *  # noqa: F403
