"""From RGB-D pictures to persistent 3D particles: online, causal, any number of cameras."""
