"""The independent world: MuJoCo stands in for the real robot, object and sensors.

It shares no equation, contact model or resolution with the simulator that predicts it, and imports nothing of it.
"""
