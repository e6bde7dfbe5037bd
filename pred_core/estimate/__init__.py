"""Following the object's state: predict with any Dynamics, correct with tracks.

`Estimator` holds a short history of states and grips, so that tracks correct the state of the time they were captured
at; `filter` is the Kalman filter of the model's error, in the smooth `modes` of the body; `gate` finds wrong tracks;
`lengths` keeps a correction from stretching the body; `starter` makes a state out of tracks alone; `health` says when
the state is lost or stands on the model alone.
"""
