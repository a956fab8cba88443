from humansim_ros.people import Human as Human
from humansim_ros.people import draw_person as draw_person
from humansim_ros.people import load_human as load_human
from humansim_ros.people import make_human as make_human
from humansim_ros.people import make_person as make_person
