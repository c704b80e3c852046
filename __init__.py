"""Station positions from spherical markers and a gimbal-mounted LiDAR."""
