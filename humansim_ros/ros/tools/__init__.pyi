from humansim_ros.ros.tools.bag_player import BagPlayer as BagPlayer
from humansim_ros.ros.tools.bench import measure as measure
from humansim_ros.ros.tools.demo import record_demo as record_demo
from humansim_ros.ros.tools.first_images import FirstImages as FirstImages
