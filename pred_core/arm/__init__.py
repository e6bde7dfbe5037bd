"""From a plan to an arm that cannot be hurt by it: the guard, the trajectory follower, the arms behind one protocol."""
