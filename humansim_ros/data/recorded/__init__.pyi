from humansim_ros.data.recorded.frames import BagFrame as BagFrame
from humansim_ros.data.recorded.frames import BagTruth as BagTruth
from humansim_ros.data.recorded.messages import Place as Place
from humansim_ros.data.recorded.messages import RecordedMessages as RecordedMessages
