from humansim_ros.people import KEYPOINT_SETS as KEYPOINT_SETS
from humansim_ros.people import KeypointLocator as KeypointLocator
from humansim_ros.people import KeypointSet as KeypointSet
from humansim_ros.people import keypoint_set as keypoint_set
