from humansim_ros.data.recorded.messages import Place as Place
from humansim_ros.data.recorded.messages import RecordedMessages as RecordedMessages
