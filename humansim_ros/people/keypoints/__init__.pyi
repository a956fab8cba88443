from humansim_ros.people.keypoints.locator import KeypointLocator as KeypointLocator
from humansim_ros.people.keypoints.locator import has_exact_skin as has_exact_skin
from humansim_ros.people.keypoints.sets import COUNTED_SETS as COUNTED_SETS
from humansim_ros.people.keypoints.sets import KEYPOINT_SETS as KEYPOINT_SETS
from humansim_ros.people.keypoints.sets import BySet as BySet
from humansim_ros.people.keypoints.sets import KeypointSet as KeypointSet
from humansim_ros.people.keypoints.sets import keypoint_set as keypoint_set
