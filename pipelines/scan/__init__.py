"""Scan log to stitched cloud: stops, gimbal angle at each pulse, levelling, rigs."""
