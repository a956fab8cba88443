from humansim_ros.data import BagMessage as BagMessage
from humansim_ros.data import BagReader as BagReader
from humansim_ros.data import BagTopic as BagTopic
from humansim_ros.data import BagWriter as BagWriter
from humansim_ros.data import Qos as Qos
from humansim_ros.data import encode_chunk as encode_chunk
