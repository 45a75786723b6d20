// UVAtlas takes its random seeds from std::random_device, and has no setting for them. A process
// that loads this with global symbols before UVAtlas gets the same "random" number every time.
extern "C" __attribute__((visibility("default"))) unsigned int
_ZNSt13random_device9_M_getvalEv(void*) {  // std::random_device::_M_getval() of libstdc++
  return 5489u;
}
