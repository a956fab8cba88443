from humansim_ros.view.app import ViewApp as ViewApp
