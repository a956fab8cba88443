#version 330
// A surface in the world.
in vec3 position;
in vec3 normal;
in vec2 uv;
in vec3 color;
uniform vec4 optical_z;  // third row of the world-to-optical transform
out vec4 v_normal;       // and the depth, to have one vector less to interpolate
out vec2 v_uv;
out vec3 v_color;
#if defined(STILL) || defined(FINISH)
out vec3 v_world;
#endif
#ifdef PEOPLE
uniform vec3 eye;
uniform vec3 sun;
out vec3 v_answer;  // of what shines: the sun, evenly from around; of cloth: what roughness adds in the sun
#endif
void main() {
    gl_Position = projected(position);
    v_normal = vec4(normal, dot(optical_z, vec4(position, 1.0)));
    v_uv = uv;
    v_color = color;
#if defined(STILL) || defined(FINISH)
    v_world = position;
#endif
#ifdef PEOPLE
    v_answer = answer(normal, normalize(eye - position), sun);
#endif
}
