from humansim_ros.render.frame.gl import GLRenderer as GLRenderer
from humansim_ros.render.frame.gl import make_renderer as make_renderer
from humansim_ros.render.frame.pyrender import PyrenderRenderer as PyrenderRenderer
