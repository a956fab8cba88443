from humansim_ros.bags.chunks import BagMessage as BagMessage
from humansim_ros.bags.chunks import encode_chunk as encode_chunk
from humansim_ros.bags.reader import BagReader as BagReader
from humansim_ros.bags.topics import BagTopic as BagTopic
from humansim_ros.bags.topics import Qos as Qos
from humansim_ros.bags.writer import BagWriter as BagWriter
