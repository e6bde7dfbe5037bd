"""The independent world: MuJoCo stands in for the real robot, object and sensors.

MuJoCo shares no contact model or resolution with the simulator that predicts it, and nothing here imports it.
`springs.py` is a second world of the same laws, written anew; a few hidden forces (drag, attraction, patch) are by law
and default range those of the candidates, which then are right.
"""
