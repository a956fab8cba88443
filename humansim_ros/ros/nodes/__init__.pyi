from humansim_ros.ros.nodes.in_process import InProcessNodes as InProcessNodes
