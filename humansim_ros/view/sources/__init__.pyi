from humansim_ros.view.sources.inputs import TopicOptions as TopicOptions
from humansim_ros.view.sources.inputs import new_scene as new_scene
from humansim_ros.view.sources.inputs import open_graph as open_graph
from humansim_ros.view.sources.inputs import open_source as open_source
