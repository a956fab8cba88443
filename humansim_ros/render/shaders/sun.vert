#version 330
// A surface as the sun sees it.
in vec3 position;
uniform mat4 clip;
#ifdef FINISH
in vec2 uv;
out vec2 v_uv;
#endif
void main() {
    gl_Position = clip * vec4(position, 1.0);
#ifdef FINISH
    v_uv = uv;
#endif
}
