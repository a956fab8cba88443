from humansim_ros.people.rigging.fitting import joints_of as joints_of
from humansim_ros.people.rigging.fitting import skeleton_at as skeleton_at
