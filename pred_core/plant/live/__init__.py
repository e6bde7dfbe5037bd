"""The stand-in world of the closed loop: a rope on a table, a slot, an arm, four cameras, all on one clock.

It is driven like a real cell: commanded gripper poses in, pictures and measured poses out.
"""
