from humansim_ros.data.bags.reader import BagReader as BagReader
from humansim_ros.data.bags.topics import BagMessage as BagMessage
from humansim_ros.data.bags.topics import BagTopic as BagTopic
from humansim_ros.data.bags.topics import Qos as Qos
from humansim_ros.data.bags.writer import BagWriter as BagWriter
from humansim_ros.data.bags.writer import encode_chunk as encode_chunk
from humansim_ros.data.evaluation.compare import Comparison as Comparison
