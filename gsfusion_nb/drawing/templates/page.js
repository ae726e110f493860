const box=document.getElementById('zoom');
document.querySelectorAll('figure img').forEach(img=>{img.addEventListener('click',()=>{
box.firstElementChild.src=img.src;box.firstElementChild.alt=img.alt;box.showModal();});});
box.addEventListener('click',()=>box.close());
